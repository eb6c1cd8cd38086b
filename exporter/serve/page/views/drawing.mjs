/** What the views have in common: the page's colours, places in a grid, and numbers between two steps. */

const NAMES = ["paper", "sheet", "ink", "soft", "rule", "accent", "good", "bad", "top", "side", "edge", "ball", "glint", "shade"];

/** The colours that the style sheet has now; light and dark are its affair. */
export function palette(element) {
  const style = getComputedStyle(element);
  return Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

/** Squares for `count` things, as large as they can be: [{ x, y, size }]. */
export function places(count, width, height, { ratio = 1, gap = 18 } = {}) {
  let best = null;
  for (let columns = 1; columns <= count; columns++) {
    const rows = Math.ceil(count / columns);
    const wide = Math.min((width - gap * (columns + 1)) / columns, ((height - gap * (rows + 1)) / rows) * ratio);
    if (best === null || wide > best.wide) best = { columns, rows, wide };
  }
  const { columns, rows, wide } = best;
  const tall = wide / ratio;
  const [left, top] = [(width - columns * wide) / (columns + 1), (height - rows * tall) / (rows + 1)];
  return Array.from({ length: count }, (_, i) => {
    const [column, row] = [i % columns, Math.floor(i / columns)];
    return { x: left + column * (wide + left), y: top + row * (tall + top), width: wide, height: tall };
  });
}

/** Pairs of numbers between two steps; an episode that has just begun does not come from the old one. */
export function between(before, after, key, i, share) {
  const next = after[key][i];
  if (before === null || after.age[i] <= before.age[i]) return next;
  const last = before[key][i];
  if (!Array.isArray(next)) return last + (next - last) * share;
  return next.map((value, k) => last[k] + (value - last[k]) * share);
}

export function rounded(context, x, y, width, height, radius) {
  context.beginPath();
  context.roundRect(x, y, width, height, radius);
}

export function disc(context, x, y, radius) {
  context.beginPath();
  context.arc(x, y, Math.max(radius, 0), 0, 2 * Math.PI);
}
