/** Images between the page, which paints rows of pixels, and the policy, which takes the layout that policy.json says. */

/** The side of an image whose size is free. */
const FREE_SIDE = 36;

/**
 * @param {{ shape: (number | null)[] }} spec of the input
 * @param {{ layout?: string, range?: [number, number] }} [preprocess] what policy.json says of it
 */
export function imageForm(spec, preprocess = {}) {
  const axes = spec.shape.slice(1);
  const channelsFirst = preprocess.layout === "NCHW";
  const [height, width, channels] = channelsFirst ? [axes[1], axes[2], axes[0]] : axes;
  return {
    height: height ?? FREE_SIDE,
    width: width ?? FREE_SIDE,
    channels: channels ?? 1,
    channelsFirst,
    range: preprocess.range ?? [0, spec.distribution?.high ?? 1],
  };
}

/**
 * What the policy is fed.
 * @param {Float32Array} pixels from 0 to 1, row by row, the channels of a pixel side by side
 */
export function fed(pixels, { height, width, channels, channelsFirst, range: [low, high] }) {
  const data = new Float32Array(pixels.length);
  const area = height * width;
  pixels.forEach((value, i) => {
    const place = channelsFirst ? (i % channels) * area + Math.floor(i / channels) : i;
    data[place] = low + value * (high - low);
  });
  return { data, shape: channelsFirst ? [1, channels, height, width] : [1, height, width, channels] };
}
