/** Records canvases side by side as a WebM, in the browser. */

const FRAMES = 30; // a second

export const canRecord = () => globalThis.MediaRecorder?.isTypeSupported("video/webm") && "captureStream" in HTMLCanvasElement.prototype;

export class Film {
  #canvas = document.createElement("canvas");
  #parts = [];
  #recorder;

  /** @param {HTMLCanvasElement[]} sources */
  constructor(sources, paper) {
    this.sources = sources;
    this.paper = paper;
    this.#canvas.width = sources.reduce((sum, { width }) => sum + width, 0);
    this.#canvas.height = Math.max(...sources.map(({ height }) => height));
    this.#recorder = new MediaRecorder(this.#canvas.captureStream(FRAMES), { mimeType: "video/webm", videoBitsPerSecond: 6e6 });
    this.#recorder.ondataavailable = ({ data }) => this.#parts.push(data);
    this.frame();
    this.#recorder.start();
  }

  frame() {
    const context = this.#canvas.getContext("2d");
    context.fillStyle = this.paper;
    context.fillRect(0, 0, this.#canvas.width, this.#canvas.height);
    let left = 0;
    for (const source of this.sources) {
      context.drawImage(source, left, 0);
      left += source.width;
    }
  }

  /** Ends, and saves it under a name. */
  async save(name) {
    const ended = new Promise((resolve) => (this.#recorder.onstop = resolve));
    this.#recorder.stop();
    await ended;
    const address = URL.createObjectURL(new Blob(this.#parts, { type: "video/webm" }));
    Object.assign(document.createElement("a"), { href: address, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(address), 60_000);
  }
}
