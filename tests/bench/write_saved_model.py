"""What a user would write to turn a frozen graph into a SavedModel with TensorFlow.

``python write_saved_model.py FILE FOLDER INPUT,... OUTPUT,...``
"""

import sys
from pathlib import Path

import tensorflow as tf

source, folder, inputs, outputs = sys.argv[1:]
definition = tf.compat.v1.GraphDef.FromString(Path(source).read_bytes())
with tf.Graph().as_default() as graph:
    tf.import_graph_def(definition, name="")
with tf.compat.v1.Session(graph=graph) as session:
    tf.compat.v1.saved_model.simple_save(
        session,
        folder,
        {name: graph.get_tensor_by_name(f"{name}:0") for name in inputs.split(",")},
        {name: graph.get_tensor_by_name(f"{name}:0") for name in outputs.split(",")},
    )
