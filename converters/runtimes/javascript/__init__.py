"""TensorFlow.js and onnxruntime-web, in Node and in Chromium."""
