// Writes TensorFlow.js layers models: node make_layers_models.mjs NODE_MODULES FOLDER
// Beside <name>.json and <name>.weights.bin lies <name>.data.json: what was fed, and what the model answered.
import { writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";

const [packages, folder] = process.argv.slice(2);
const require = createRequire(path.join(packages, "index.js"));
const tf = require("@tensorflow/tfjs");
const l = tf.layers;
await tf.setBackend("cpu");

const chain = (...parts) => tf.sequential({ layers: parts });
function recurrent() {
  const x = tf.input({ shape: [3, 4] });
  const outputs = [
    l.lstm({ units: 3 }).apply(x),
    l.gru({ units: 2, recurrentActivation: "sigmoid" }).apply(x),
    l.simpleRNN({ units: 3, returnSequences: true }).apply(x),
    l.bidirectional({ layer: l.lstm({ units: 2 }), mergeMode: "concat" }).apply(x),
    l.rnn({ cell: l.stackedRNNCells({ cells: [l.gruCell({ units: 3 }), l.simpleRNNCell({ units: 4 })] }) }).apply(x),
    l.timeDistributed({ layer: l.dense({ units: 2, activation: "hardSigmoid" }) }).apply(x),
  ];
  return tf.model({ inputs: x, outputs });
}
function nested() {
  const x = tf.input({ shape: [5], name: "observation" });
  const inner = chain(l.dense({ units: 4, inputShape: [5], activation: "elu" }), l.batchNormalization());
  const twice = inner.apply(x);
  const joined = l.concatenate().apply([twice, l.add().apply([twice, l.dense({ units: 4 }).apply(x)])]);
  return tf.model({ inputs: x, outputs: l.dense({ units: 2, activation: "tanh", name: "action" }).apply(joined) });
}
const models = {
  dense: () => chain(l.dense({ units: 4, inputShape: [6], activation: "relu" }), l.dense({ units: 3, activation: "softmax" })),
  image: () =>
    chain(
      l.conv2d({ filters: 3, kernelSize: 3, strides: 2, padding: "same", inputShape: [9, 8, 2], activation: "relu6" }),
      l.depthwiseConv2d({ kernelSize: 2, depthMultiplier: 2 }),
      l.layerNormalization(),
      l.separableConv2d({ filters: 4, kernelSize: 2 }),
      l.maxPooling2d({ poolSize: 2 }),
      l.flatten(),
      l.dropout({ rate: 0.5 }),
      l.dense({ units: 2 }),
    ),
  embedding: () => chain(l.embedding({ inputDim: 7, outputDim: 3, inputLength: 4 }), l.flatten(), l.dense({ units: 2 })),
  recurrent,
  nested,
};
for (const [name, make] of Object.entries(models)) {
  const model = make();
  const drawn = (w, i) => tf.randomUniform(w.shape, w.originalName.includes("variance") ? 0.1 : -0.7, 0.7, "float32", i + 1);
  model.setWeights(model.weights.map(drawn));
  const shape = [2, ...model.inputs[0].shape.slice(1)];
  const fed = name === "embedding" ? tf.tensor2d([1, 6, 0, 3, 2, 2, 5, 4], [2, 4]) : tf.randomUniform(shape, -2, 2, "float32", 9);
  const given = [model.predict(fed)].flat();
  await model.save({
    save: async (parts) => {
      const weights = [{ paths: [`${name}.weights.bin`], weights: parts.weightSpecs }];
      const { format, modelTopology, generatedBy } = parts;
      writeFileSync(path.join(folder, `${name}.json`), JSON.stringify({ format, generatedBy, modelTopology, weightsManifest: weights }));
      writeFileSync(path.join(folder, `${name}.weights.bin`), Buffer.from(parts.weightData));
      return { modelArtifactsInfo: { dateSaved: new Date() } };
    },
  });
  const kept = (t) => ({ shape: t.shape, values: [...t.dataSync()] });
  writeFileSync(path.join(folder, `${name}.data.json`), JSON.stringify({ fed: kept(fed), given: given.map(kept) }));
}
