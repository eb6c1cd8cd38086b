/** The page's files: those that it holds, where it is one file; else those that lie beside it. */

const held = document.getElementById("files");
const embedded = held === null ? null : JSON.parse(held.textContent);

/** Whether the page is one file, opened from anywhere. */
export const isOneFile = embedded !== null;

async function fetched(name) {
  const answer = await fetch(name);
  if (!answer.ok) throw new Error(`${name} is not there (HTTP status ${answer.status})`);
  return answer;
}

function own(name) {
  if (!Object.hasOwn(embedded, name)) throw new Error(`${name} is not in this file`);
  return embedded[name];
}

export const json = async (name) => (isOneFile ? own(name) : (await fetched(name)).json());

/** @returns {Promise<ArrayBuffer>} */
export async function bytes(name) {
  if (!isOneFile) return (await fetched(name)).arrayBuffer();
  return Uint8Array.from(atob(own(name)), (letter) => letter.charCodeAt(0)).buffer;
}

/** A graph model as TensorFlow.js' loaders give it: model.json's fields, `weightSpecs`, and the shards joined. */
export async function artifacts(folder, read = { json, bytes }) {
  const model = await read.json(`${folder}model.json`);
  const groups = model.weightsManifest ?? [];
  const shards = await Promise.all(groups.flatMap(({ paths }) => paths).map((path) => read.bytes(folder + path)));
  const weightData = await new Blob(shards).arrayBuffer();
  return { ...model, weightSpecs: groups.flatMap(({ weights }) => weights), weightData };
}

export function script(src) {
  return new Promise((resolve, reject) => {
    const element = Object.assign(document.createElement("script"), { src });
    element.onload = () => resolve();
    element.onerror = () => reject(new Error(`${src} did not load`));
    document.head.append(element);
  });
}
