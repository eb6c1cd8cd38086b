"""TensorFlow.js graph models: ``model.json`` and weight shards, made without the tensorflowjs package."""
