"""What Keras' layers compute, by the layers of ``converters/graph/nn``. A file per kind; ``table.py`` has them all.

Formulas and the order of the weights: keras/src/layers of Keras 3.15, tf_keras 2.21, tfjs-layers 4.22.
"""
