"""TensorFlow.js and onnxruntime-web, in Node and in Chromium."""

from export_model.converters.runtimes.javascript import browser, node

RUNTIMES = (*node.RUNTIMES, *browser.RUNTIMES)
