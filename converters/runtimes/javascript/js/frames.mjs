/**
 * Frames on a pair of streams, as converters/files/children/frames.py writes them.
 *
 * A frame, both ways: a little-endian uint32, the length of a header; the header, JSON in UTF-8; then the bytes of the
 * tensors that `header.tensors` = [{"name", "dtype", "shape"}] lists, one after the other, little-endian, in C order.
 * dtypes are numpy's names; bool has 1 byte an element.
 */

import { Console } from "node:console";
import process from "node:process";

/** Bytes of an element. More dtypes than any runtime accepts, so that a refused tensor's frame can be stepped over. */
const ELEMENT_BYTES = {
  bool: 1, int8: 1, uint8: 1, int16: 2, uint16: 2, float16: 2,
  int32: 4, uint32: 4, float32: 4, int64: 8, uint64: 8, float64: 8,
};

/** No header comes near this; a longer one means that the two sides are out of step. */
const MAX_HEADER_BYTES = 64 * 1024 * 1024;

/** The frames cannot be followed any more: nothing that comes after can be understood. */
export class FramingError extends Error {}

/** Takes exact numbers of bytes from a stream. */
export class ByteReader {
  #chunks;
  #rest = Buffer.alloc(0);

  constructor(stream) {
    this.#chunks = stream[Symbol.asyncIterator]();
  }

  /**
   * @param {number} count
   * @returns {Promise<Buffer | null>} null where the stream ends before the first of these bytes
   */
  async take(count) {
    const parts = [this.#rest];
    let size = this.#rest.length;
    while (size < count) {
      const { done, value } = await this.#chunks.next();
      if (done) {
        if (size === 0) return null;
        throw new FramingError(`stdin ended within a frame: ${size} of ${count} bytes`);
      }
      parts.push(value);
      size += value.length;
    }
    const all = parts.length === 1 ? parts[0] : Buffer.concat(parts, size);
    this.#rest = all.subarray(count);
    return all.subarray(0, count);
  }
}

/**
 * Reads one frame whole, also where its tensors are not acceptable: the next frame begins behind it.
 * @param {ByteReader} reader
 * @returns {Promise<{header: object, bodies: Buffer[]} | {problem: string} | null>} null at the end of stdin
 */
export async function readFrame(reader) {
  const prefix = await reader.take(4);
  if (prefix === null) return null;
  const length = prefix.readUInt32LE();
  if (length > MAX_HEADER_BYTES) throw new FramingError(`a header of ${length} bytes`);
  const text = (await takeAll(reader, length)).toString("utf8");
  let header;
  try {
    header = JSON.parse(text);
  } catch (error) {
    // A header that is no JSON lists no tensors: the next frame is taken to begin right behind it.
    return { problem: `the header is not JSON: ${error.message}` };
  }
  if (header === null || typeof header !== "object" || Array.isArray(header)) {
    return { problem: "the header is not an object" };
  }
  const specs = header.tensors ?? [];
  if (!Array.isArray(specs)) throw new FramingError('"tensors" is not a list');
  const bodies = [];
  for (const spec of specs) bodies.push(await takeAll(reader, byteLength(spec)));
  return { header, bodies };
}

/** As `reader.take`, within a frame: the end of the stream is an error here. */
async function takeAll(reader, count) {
  if (count === 0) return Buffer.alloc(0);
  const bytes = await reader.take(count);
  if (bytes === null) throw new FramingError("stdin ended within a frame");
  return bytes;
}

/** How many bytes a listed tensor has in the frame. */
function byteLength(spec) {
  const { name, dtype, shape } = spec ?? {};
  const bytes = ELEMENT_BYTES[dtype];
  const valid = Array.isArray(shape) && shape.every((dim) => Number.isSafeInteger(dim) && dim >= 0);
  if (bytes === undefined || !valid) {
    throw new FramingError(`the length of tensor '${name}' is unknown: dtype ${dtype}, shape ${JSON.stringify(shape)}`);
  }
  const count = shape.reduce((product, dim) => product * dim, bytes);
  if (!Number.isSafeInteger(count)) throw new FramingError(`tensor '${name}' is too large: ${JSON.stringify(shape)}`);
  return count;
}

/**
 * @param {(bytes: Buffer, done: (error?: Error | null) => void) => unknown} write stdout's own
 * @param {object} header
 * @param {Uint8Array[]} bodies
 */
export function writeFrame(write, header, bodies) {
  const text = Buffer.from(JSON.stringify(header), "utf8");
  const prefix = Buffer.alloc(4);
  prefix.writeUInt32LE(text.length);
  // Waiting for the write keeps one answer in memory at most, and lets the last one out before the process ends.
  return new Promise((resolve, reject) => {
    write(Buffer.concat([prefix, text, ...bodies]), (error) => (error ? reject(error) : resolve()));
  });
}

/** Keeps stdout for frames: what any package prints goes to stderr. */
export function takeStdout() {
  const write = process.stdout.write.bind(process.stdout);
  process.stdout.write = process.stderr.write.bind(process.stderr);
  globalThis.console = new Console(process.stderr, process.stderr);
  // The parent has gone: there is nobody left to tell.
  process.stdout.on("error", () => process.exit(1));
  return write;
}
