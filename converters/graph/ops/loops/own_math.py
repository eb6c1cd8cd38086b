"""Mathematical functions in float32 arithmetic alone, for ``--math own``: the same bits on every processor.

Libraries round exp(x) as they like; +, -, *, / and sqrt are rounded one way alone (IEEE 754). Each function is an
expression of the loop language, so that it is written once and printed in every language. Coefficients are of Cephes
(Moshier) and of fdlibm (Sun Microsystems, 1993), but for erf's, which were fitted here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from msgspec import Struct

from export_model.converters.graph.ops.loops.base import Expression, Number, apply, holds, number, select_expression
from export_model.converters.graph.types import FLOAT32, INT32


class Own(Struct, frozen=True):
    """A function of float32, and how far it is off at most, in units in the last place of the true value."""

    function: Callable[..., Expression]
    ulps: float
    where: str = "all floats"


def _f(value: float) -> Number:
    return Number(value, FLOAT32)


def _add(a: Expression, b: Expression) -> Expression:
    return apply("add", a, b)


def _sub(a: Expression, b: Expression) -> Expression:
    return apply("sub", a, b)


def _mul(a: Expression, b: Expression) -> Expression:
    return apply("mul", a, b)


def _div(a: Expression, b: Expression) -> Expression:
    return apply("div", a, b)


def _bits(x: Expression) -> Expression:
    return apply("bits", x, dtype=INT32)


def _of_bits(i: Expression) -> Expression:
    return apply("of_bits", i, dtype=FLOAT32)


def _polynomial(x: Expression, *factors: float) -> Expression:
    """By Horner; the factor of the highest power first."""
    total: Expression = _f(factors[0])
    for factor in factors[1:]:
        total = _add(_mul(total, x), _f(factor))
    return total


def _choose(condition: Expression, a: Expression, b: Expression) -> Expression:
    return select_expression(condition, a, b)


def _is_number(x: Expression) -> Expression:
    """Not NaN."""
    return holds("less_equal", x, _f(np.inf))


def _within(x: Expression, low: float, high: float) -> Expression:
    """Clamped; NaN is ``low``, so that no integer that is made of it overflows."""
    return _choose(holds("less", _f(low), x), _choose(holds("less", x, _f(high)), x, _f(high)), _f(low))


#: ln 2 in two parts; the first has so few bits that its multiples are exact.
_LN2 = (0.693359375, -2.12194440e-4)


def _nearest(x: Expression, above: int = 0) -> tuple[Expression, Expression]:
    """The nearest whole number, as a float and as an integer; x is larger than -``above``, and below 2 to the 22.

    No branch, and no sum that ``-ffast-math`` takes back.
    """
    k = _sub(apply("whole", _add(x, _f(above + 0.5)), dtype=INT32), number(above))
    return apply("cast", k, dtype=FLOAT32), k


def _less_multiple(x: Expression, count: Expression, parts: tuple[float, ...]) -> Expression:
    """X less a multiple of a constant that is given in parts."""
    for part in parts:
        x = _sub(x, _mul(count, _f(part)))
    return x


def _power_of_two(k: Expression) -> Expression:
    return _of_bits(_mul(_add(k, number(127)), number(1 << 23)))


def _expm1_near_zero(r: Expression) -> Expression:
    """exp(r) - 1 for |r| up to ln 2 / 2."""
    factors = (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1)
    return _add(_mul(_mul(r, r), _polynomial(r, *factors)), r)


def _powers(k: Expression) -> tuple[Expression, Expression, Expression]:
    """2 to the k by two factors, of which each is a normal number, and 2 to the -k."""
    half = _div(k, number(2))
    rest = _sub(k, half)
    back = _mul(_power_of_two(_sub(number(0), half)), _power_of_two(_sub(number(0), rest)))
    return _power_of_two(half), _power_of_two(rest), back


def exp(x: Expression) -> Expression:
    """A power of two, in two steps (the result may be below the least normal number), times what is left."""
    within = _within(x, -104.0, 89.0)
    count, k = _nearest(_mul(within, _f(1.44269504)), 151)
    near = _add(_f(1), _expm1_near_zero(_less_multiple(within, count, _LN2)))
    first, second, _ = _powers(k)
    scaled = _mul(_mul(near, first), second)
    return _choose(_is_number(x), scaled, x)


def expm1(x: Expression) -> Expression:
    """2 to the k times (exp(r) - 1 + 1 - 2 to the -k), of the same steps for every number: no branch."""
    within = _within(x, -17.4, 89.0)
    count, k = _nearest(_mul(within, _f(1.44269504)), 151)
    first, second, back = _powers(k)
    near = _add(_expm1_near_zero(_less_multiple(within, count, _LN2)), _sub(_f(1), back))
    scaled = _mul(_mul(near, first), second)
    return _choose(_is_number(x), scaled, x)


def log(x: Expression) -> Expression:
    """From sqrt(1/2) to sqrt(2) by s = f / (2 + f) with f = m - 1; then k ln 2 is added."""
    normal = holds("and", holds("less", _f(0), x), holds("less", x, _f(np.inf)))
    tiny = holds("less", x, _f(2.0**-126))
    given = _choose(normal, _choose(tiny, _mul(x, _f(2.0**23)), x), _f(1))
    bits = _add(_bits(given), number(0x3F800000 - 0x3F3504F3))
    exponent = _div(bits, number(1 << 23))
    m = _of_bits(_add(_sub(bits, _mul(exponent, number(1 << 23))), number(0x3F3504F3)))
    k = apply("cast", _sub(exponent, _choose(tiny, number(150), number(127))), dtype=FLOAT32)
    f = _sub(m, _f(1))
    s = _div(f, _add(_f(2), f))
    z = _mul(s, s)
    rest = _mul(z, _polynomial(z, 0.24279078841, 0.28498786688, 0.40000972152, 0.66666662693))
    half = _mul(_mul(_f(0.5), f), f)
    low = _add(_mul(s, _add(half, rest)), _mul(k, _f(9.0580006145e-06)))
    found = _add(_add(_sub(low, half), f), _mul(k, _f(6.9313812256e-01)))
    outside = _choose(holds("less", _f(0), x), x, _choose(holds("equal", x, _f(0)), _f(-np.inf), _f(np.nan)))
    return _choose(normal, found, outside)


def log1p(x: Expression) -> Expression:
    """log(u) with u = 1 + x, less what was lost in that sum, divided by u."""
    u = _add(_f(1), x)
    lost = _div(_sub(_sub(u, _f(1)), x), u)
    normal = holds("and", holds("less", _f(0), u), holds("less", u, _f(np.inf)))
    whole = apply("log", u)
    return _choose(normal, _sub(whole, lost), whole)


def tanh(x: Expression) -> Expression:
    """-e / (e + 2) with e = exp(-2 |x|) - 1, and the sign of x."""
    size = apply("abs", x)
    e = apply("expm1", apply("neg", _add(size, size)))
    found = _div(e, _add(e, _f(2)))
    return _choose(holds("less", x, _f(0)), found, apply("neg", found))


#: pi / 2 in three parts, whose multiples are exact for the first two while the angle is below ``_TURNS``.
_QUARTER = (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8)
_TURNS = 8192.0


def _waves(x: Expression) -> tuple[Expression, Expression, Expression]:
    """Of an angle that is not negative: sine and cosine of what is left of a quarter turn, and which quarter."""
    near = _choose(holds("less", x, _f(_TURNS)), x, apply("mod", x, _f(2 * np.pi)))
    count, k = _nearest(_mul(_choose(holds("less", near, _f(_TURNS)), near, _f(0)), _f(2 / np.pi)))
    r = _less_multiple(near, count, _QUARTER)
    z = _mul(r, r)
    sine = _add(_mul(_mul(_polynomial(z, -1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1), z), r), r)
    cosine = _polynomial(z, 2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)
    cosine = _add(_sub(_mul(_mul(cosine, z), z), _mul(_f(0.5), z)), _f(1))
    return sine, cosine, _sub(k, _mul(_div(k, number(4)), number(4)))


def _wave(size: Expression, odd: bool) -> Expression:
    """The sine, or the cosine, of an angle that is not negative."""
    sine, cosine, quarter = _waves(size)
    first, second = (sine, cosine) if odd else (cosine, apply("neg", sine))
    third, fourth = apply("neg", first), apply("neg", second)
    rest = _choose(holds("equal", quarter, number(2)), third, fourth)
    rest = _choose(holds("equal", quarter, number(1)), second, rest)
    return _choose(holds("equal", quarter, number(0)), first, rest)


def sin(x: Expression) -> Expression:
    """What is left of quarter turns, by the polynomial of its quarter."""
    found = _wave(apply("abs", x), odd=True)
    return _choose(holds("less", x, _f(0)), apply("neg", found), found)


def cos(x: Expression) -> Expression:
    """As the sine."""
    return _wave(apply("abs", x), odd=False)


def tan(x: Expression) -> Expression:
    """The sine by the cosine."""
    return _div(apply("sin", x), apply("cos", x))


#: erfc(x) exp(x * x) by powers of 1 / (1 + x / 2), the highest first, for x from 1 to 4.
_ERFC = (-0.230988741, 0.637232843, -0.0651122726, 0.397185034, 0.259588421, 0.00183558803)


def erf(x: Expression) -> Expression:
    """An odd polynomial below 1, else 1 - erfc."""
    size, z = apply("abs", x), _mul(x, x)
    factors = (7.853861353153693e-5, -8.010193625184903e-4, 5.188327685732524e-3, -2.685381193529856e-2,
               1.128358514861418e-1, -3.761262582423300e-1, 1.128379165726710)  # fmt: skip
    t = _div(_f(1), _add(_f(1), _mul(_f(0.5), size)))
    far = _sub(_f(1), _mul(apply("exp", apply("neg", z)), _polynomial(t, *_ERFC)))
    far = _choose(holds("less", _f(4), size), _f(1), far)
    signed = _choose(holds("less", x, _f(0)), apply("neg", far), far)
    return _choose(holds("less", size, _f(1)), _mul(x, _polynomial(z, *factors)), _choose(_is_number(x), signed, x))


def power(a: Expression, b: Expression) -> Expression:
    """exp(b log |a|), negative where a is and b is odd; squares and roots as they are rounded."""
    whole = holds("equal", apply("floor", b), b)
    half = _mul(b, _f(0.5))
    odd = holds("and", whole, apply("not", holds("equal", apply("floor", half), half)))
    size = apply("exp", _mul(b, apply("log", apply("abs", a))))
    below = _choose(whole, _choose(odd, apply("neg", size), size), _f(np.nan))
    found = _choose(holds("less", a, _f(0)), below, size)
    found = _choose(holds("equal", b, _f(2)), _mul(a, a), found)
    found = _choose(holds("equal", b, _f(0.5)), apply("sqrt", a), found)
    one = holds("or", holds("equal", b, _f(0)), holds("equal", a, _f(1)))
    return _choose(one, _f(1), found)


#: Nearer to a zero the quarter turns in three parts are off by up to 1e-10, which is many units of a small result.
_ANGLES = "results from 0.001 to 1000, angles below 8192"
#: Function of the loop language → its own form. tests/programs/test_own_math.py measures the errors.
OWN: Mapping[str, Own] = {
    "exp": Own(exp, 1.0),
    "expm1": Own(expm1, 2.0),
    "log": Own(log, 1.0),
    "log1p": Own(log1p, 2.0),
    "tanh": Own(tanh, 3.0),
    "sin": Own(sin, 3.0, _ANGLES),
    "cos": Own(cos, 3.0, _ANGLES),
    "tan": Own(tan, 5.0, _ANGLES),
    "erf": Own(erf, 3.0),
    "pow": Own(power, 200.0, "results from 1e-30 to 1e30"),
}
