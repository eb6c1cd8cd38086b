"""What is not translated is refused by name, and only where the policy depends on it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.formats.barracuda.format import Trailer, parse
from export_model.converters.formats.barracuda.graph import to_graph
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType, layer_label
from export_model.signatures.errors import DamagedFileError, ExportModelError, GraphError, UnsupportedOpError
from tests.barracuda.nn_files import Maker, write_nn

X = "vector_observation"


def built(build: Callable[[Maker], object], version: int = 16, *shape: int) -> Maker:
    m = Maker(version)
    m.input(X, *(shape or (1, 1, 6)))
    build(m)
    return m


def read(m: Maker, **options: object) -> object:
    return to_graph(parse(write_nn(m.model(**options))))  # type: ignore[arg-type]


REFUSED = (
    *("LRN", "LSTM", "RESAMPLE2D", "TOP_K_INDICES", "TOP_K_VALUES", "NON_ZERO", "RANGE", "ROI_ALIGN", "SHAPE"),
    *("CONSTANT_OF_SHAPE", "NON_MAX_SUPPRESSION", "SCATTER_ND", "CONV3D", "CONV3D_TRANS", "UPSAMPLE3D", "PAD"),
    *("MAX_POOL3D", "AVG_POOL3D", "GLOBAL_MAX_POOL3D", "GLOBAL_AVG_POOL3D", "BORDER3D"),
)


@pytest.mark.parametrize("kind", REFUSED)
def test_a_layer_that_is_not_translated(kind: str) -> None:
    number = LayerType[kind]
    with pytest.raises(UnsupportedOpError) as caught:
        read(built(lambda m: m.layer("action", number, X)))
    error = caught.value
    assert error.issues == (("action", layer_label(number)),)
    assert "'action'" in error.what
    assert str(int(number)) in error.what
    assert error.why
    assert error.fix


def test_every_layer_type_is_translated_or_refused_on_purpose() -> None:
    for number in LayerType:
        if number.name in REFUSED or number is LayerType.LOAD:
            continue
        try:
            read(built(lambda m, number=number: m.layer("action", number, X)), trailer=Trailer("", "", ""))
        except UnsupportedOpError as error:
            assert "cannot be converted" not in str(error), number
        except GraphError:
            pass  # it is known, and this is not how it is written


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda m: m.layer("action", 999, X), "an unknown one \\(999\\)"),
        (lambda m: m.layer("action", 50, X, activation=77), "an unknown one \\(77\\)"),
        (lambda m: m.layer("action", 128, X, axis=0), "reduces over the batch"),
        (lambda m: m.layer("action", 210, X, X, axis=0), "joins along the batch"),
        (lambda m: m.layer("action", 202, X, pool=(3, 1, 2, 0)), "agents into pixels"),
        (lambda m: m.layer("action", 201, X, pool=(-1, 1, 1, 3)), "agents would be mixed"),
        (lambda m: m.layer("action", 201, X, pool=(2, 1, 1, 3)), "agents would be mixed"),
        (lambda m: m.layer("action", 212, X, pool=(2, 1, 1, 1)), "one row per agent"),
        (lambda m: m.layer("action", 211, X, pad=(1, 0, 0, 0), pool=(2, 0, 0, 0), stride=(1,) * 4), "of the batch"),
        (lambda m: m.layer("action", 211, X, pad=(0,) * 4, pool=(0, 0, 0, 5), stride=(1, 1, 1, 2)), "does not divide"),
        (lambda m: m.layer("action", 211, X, pad=(0,) * 4, pool=(0,) * 4, stride=(1, 1, 1, -1)), "read that differ"),
        (lambda m: m.layer("action", 23, X, pool=(2, 2), axis=1), "interpolates"),
        (lambda m: m.layer("action", 23, X), "wrote no factors"),
        (lambda m: m.layer("action", 2, X, X), "the batch cannot be summed over"),
    ],
)
def test_a_variant_that_is_not_translated(build: Callable[[Maker], object], words: str) -> None:
    with pytest.raises(UnsupportedOpError, match=words) as caught:
        read(built(build))
    assert caught.value.fix


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda m: m.layer("action", 100, X, m.load("c", np.ones(5))), "do not broadcast"),
        (
            lambda m: m.layer("action", 1, X, data={"k": np.ones((5, 1, 1, 2)), "b": np.ones((1, 1, 1, 2))}),
            "a row of 6",
        ),
        (lambda m: m.layer("action", 1, X, data={"k": np.ones((6, 1, 1, 2))}), "it takes 3"),
        (lambda m: m.layer("action", 25, X, pool=(2, 2), stride=(1, 1)), "larger than the image"),
        (lambda m: m.layer("action", 25, X, pool=(1, 1), stride=(0, 1)), "numbers above 0"),
        (lambda m: m.layer("action", 210, X, "c", axis=3), "which must be an input"),
        (lambda m: m.layer("action", 50, "later"), "'later', which must be an input or made by a layer before it"),
        (lambda m: (m.layer("action", 50, X), m.layer("action", 50, X)), "two layers are called 'action'"),
        (lambda m: m.layer("action", 211, X, pad=(0, 0, 0, 6), pool=(0,) * 4, stride=(1,) * 4), "behind the end"),
    ],
)
def test_a_layer_that_contradicts_itself(build: Callable[[Maker], object], words: str) -> None:
    with pytest.raises(ExportModelError, match=words):
        read(built(build))


def test_fused_activations_whose_parameters_unity_drops() -> None:
    for number in (7, 8, 13, 21, 103, 112):
        with pytest.raises(UnsupportedOpError, match="drops the parameters"):
            read(built(lambda m, number=number: m.layer("action", 100, X, X, activation=number, alpha=0.5)))


def test_an_op_that_the_converter_let_through() -> None:
    """Three tensors in a layer of a binary op; from Unity's own writer, that is how n-ary ops are stored."""
    m = built(lambda m: m.layer("action", 110, X, m.load("a", 1.0), m.load("b", 2.0)))
    with pytest.raises(DamagedFileError, match=r"'action' \(Min \(110\)\) reads 3 tensors: vector_observation, a, b"):
        read(m)
    read(m, trailer=Trailer("ONNX", "6", "pytorch"))
    with pytest.raises(DamagedFileError, match="reads 2 tensors"):
        read(built(lambda m: m.layer("action", 50, X, m.load("a", 1.0), activation=3)))


def test_what_the_policy_does_not_depend_on_may_be_anything() -> None:
    def build(m: Maker) -> None:
        m.layer("aside", 53, X)
        m.layer("behind", 50, "aside")
        m.layer("action", 50, X, activation=3)

    graph = to_graph(parse(write_nn(built(build).model()))).graph
    assert "aside" not in graph
    assert "behind" not in graph
    (policy,) = compile_graph(graph, "p")
    assert [s.name for s in policy.signature.inputs] == ["state"]


def test_an_input_without_a_length_matters_only_where_it_is_read() -> None:
    def build(m: Maker) -> None:
        m.input("batch_size", -1, -1, -1)
        m.layer("action", 50, X)

    read(built(build))
    m = Maker()
    m.input(X, 1, 1, -1)
    m.layer("action", 50, X)
    with pytest.raises(ExportModelError, match="does not say how long it is"):
        read(m)


def test_softmax_of_an_image_is_taken_as_the_version_defines_it() -> None:
    shape = (2, 3, 4)
    read(built(lambda m: m.layer("action", 50, X, activation=2), 16, *shape))
    read(built(lambda m: m.layer("action", 50, X, activation=2, axis=7), 18, *shape))
    with pytest.raises(UnsupportedOpError, match="took the whole row"):
        read(built(lambda m: m.layer("action", 50, X, activation=2), 17, *shape))
    with pytest.raises(UnsupportedOpError, match="axis 6"):
        read(built(lambda m: m.layer("action", 50, X, activation=2, axis=6), 18, *shape))
