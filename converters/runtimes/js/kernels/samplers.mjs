/** Samplers inside a graph. `attrs.random` gives uniform numbers in [0, 1). */

import { each, numbers, zeros } from "./tensors.mjs";

/** N(0, 1), by Box and Muller. */
const normal = (random) => Math.sqrt(-2 * Math.log(1 - random())) * Math.cos(2 * Math.PI * random());

function truncated(random) {
  for (;;) {
    const drawn = normal(random);
    if (Math.abs(drawn) <= 2) return drawn;
  }
}

const drawn = (draw) => ({ random }, shape) => each("float32", () => draw(random), zeros("float32", numbers(shape)));

/** Indices by their unnormalised log-probabilities: the largest of logit + Gumbel noise. */
function multinomial({ random }, logits, count) {
  const [rows, classes] = logits.shape;
  const result = zeros("int32", [rows, count.data[0]]);
  result.data.forEach((_, i) => {
    const row = Math.floor(i / count.data[0]) * classes;
    let most = -Infinity;
    for (let k = 0; k < classes; k++) {
      const score = logits.data[row + k] - Math.log(-Math.log(random() + 1e-300));
      if (score > most) [most, result.data[i]] = [score, k];
    }
  });
  return result;
}

export const SAMPLERS = {
  RandomStandardNormal: drawn(normal),
  TruncatedNormal: drawn(truncated),
  RandomUniform: drawn((random) => random()),
  Multinomial: multinomial,
};
