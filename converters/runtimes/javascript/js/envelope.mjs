/**
 * What crosses between a page and the process that drives it (browser_server.mjs): a little-endian uint32, the length
 * of a text; the text, JSON {"fields", "lengths"}; then as many bodies as there are lengths, of that many bytes.
 *
 * Tensors cross as the bytes that they are in a frame. Nothing here is Node's own.
 */

/**
 * @param {object} fields
 * @param {Uint8Array[]} bodies
 * @returns {Uint8Array[]} the parts, to be joined
 */
export function pack(fields, bodies) {
  const text = new TextEncoder().encode(JSON.stringify({ fields, lengths: bodies.map((body) => body.byteLength) }));
  const prefix = new Uint8Array(4);
  new DataView(prefix.buffer).setUint32(0, text.length, true);
  return [prefix, text, ...bodies];
}

/**
 * @param {Uint8Array} bytes
 * @returns {{fields: object, bodies: Uint8Array[]}} the bodies are views of `bytes`
 */
export function unpack(bytes) {
  const size = new DataView(bytes.buffer, bytes.byteOffset).getUint32(0, true);
  let offset = 4 + size;
  const { fields, lengths } = JSON.parse(new TextDecoder().decode(bytes.subarray(4, offset)));
  const bodies = lengths.map((length) => {
    offset += length;
    return bytes.subarray(offset - length, offset);
  });
  return { fields, bodies };
}
