/** Convolutions, pooling and padding, all NHWC. */

import { fused } from "./linear.mjs";
import { each, offsets, stridesOf, zeros } from "./tensors.mjs";

/** [result length, padding before] of a sliding window; SAME puts the odd element of padding at the end. */
function windows(size, window, stride, padding) {
  if (padding === "VALID") return [Math.max(Math.ceil((size - window + 1) / stride), 0), 0];
  const count = Math.ceil(size / stride);
  return [count, Math.floor(Math.max((count - 1) * stride + window - size, 0) / 2)];
}

/**
 * Calls `visit(place of the result's pixel, [[place of a pixel in the image, number of the window's cell], …])`, for
 * the cells of the window that lie inside the image.
 */
function slide({ strides, dilations = [1, 1, 1, 1], padding }, [batch, height, width], [tall, wide], visit) {
  const [rows, top] = windows(height, (tall - 1) * dilations[1] + 1, strides[1], padding);
  const [columns, left] = windows(width, (wide - 1) * dilations[2] + 1, strides[2], padding);
  let place = 0;
  for (let n = 0; n < batch; n++) {
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++, place++) {
        const cells = [];
        for (let i = 0; i < tall; i++) {
          const y = row * strides[1] - top + i * dilations[1];
          if (y < 0 || y >= height) continue;
          for (let j = 0; j < wide; j++) {
            const x = column * strides[2] - left + j * dilations[2];
            if (x >= 0 && x < width) cells.push([(n * height + y) * width + x, i * wide + j]);
          }
        }
        visit(place, cells);
      }
    }
  }
  return [batch, rows, columns];
}

function resultShape(attrs, image, window) {
  return [image[0], ...[1, 2].map((i) => {
    const span = (window[i - 1] - 1) * (attrs.dilations?.[i] ?? 1) + 1;
    return windows(image[i], span, attrs.strides[i], attrs.padding)[0];
  })];
}

function convolution(attrs, image, kernel) {
  const [, , channels, filters] = kernel.shape;
  const result = zeros(image.dtype, [...resultShape(attrs, image.shape, kernel.shape), filters]);
  const sums = new Float64Array(filters);
  slide(attrs, image.shape, kernel.shape, (place, cells) => {
    sums.fill(0);
    for (const [pixel, cell] of cells) {
      for (let c = 0; c < channels; c++) {
        const value = image.data[pixel * channels + c];
        const start = (cell * channels + c) * filters;
        for (let f = 0; f < filters; f++) sums[f] += value * kernel.data[start + f];
      }
    }
    result.data.set(sums, place * filters);
  });
  return result;
}

function depthwise(attrs, image, kernel) {
  const [, , channels, times] = kernel.shape;
  const result = zeros(image.dtype, [...resultShape(attrs, image.shape, kernel.shape), channels * times]);
  const sums = new Float64Array(channels * times);
  slide(attrs, image.shape, kernel.shape, (place, cells) => {
    sums.fill(0);
    for (const [pixel, cell] of cells) {
      for (let k = 0; k < sums.length; k++) {
        sums[k] += image.data[pixel * channels + Math.floor(k / times)] * kernel.data[cell * sums.length + k];
      }
    }
    result.data.set(sums, place * sums.length);
  });
  return result;
}

/** Cells outside of the image do not count. */
function pool(start, work, finish) {
  return (attrs, image) => {
    const channels = image.shape[3];
    const window = attrs.ksize.slice(1, 3);
    const result = zeros(image.dtype, [...resultShape(attrs, image.shape, window), channels]);
    slide(attrs, image.shape, window, (place, cells) => {
      for (let c = 0; c < channels; c++) {
        const value = cells.reduce((sum, [pixel]) => work(sum, image.data[pixel * channels + c]), start);
        result.data[place * channels + c] = finish(value, cells.length);
      }
    });
    return result;
  };
}

function pad(_, x, paddings, fill) {
  const before = x.shape.map((_, i) => paddings.data[2 * i]);
  const shape = x.shape.map((n, i) => n + before[i] + paddings.data[2 * i + 1]);
  const result = each(x.dtype, () => fill?.data[0] ?? 0, zeros(x.dtype, shape));
  const strides = stridesOf(shape);
  const places = offsets(x.shape, strides, before.reduce((sum, n, i) => sum + n * strides[i], 0));
  places.forEach((place, i) => (result.data[place] = x.data[i]));
  return result;
}

export const IMAGES = {
  Conv2D: convolution,
  _FusedConv2D: (attrs, image, kernel, bias) => fused(attrs, convolution(attrs, image, kernel), bias),
  DepthwiseConv2dNative: depthwise,
  MaxPool: pool(-Infinity, Math.max, (value) => value),
  AvgPool: pool(0, (a, b) => a + b, (sum, count) => sum / count),
  Pad: pad,
  PadV2: pad,
};
