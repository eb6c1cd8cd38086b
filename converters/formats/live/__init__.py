"""What lives in the caller's process as a source: a session, a ``tf.function``, a Keras model.

TensorFlow is the caller's own, taken from ``sys.modules``; nothing here loads it.
"""
