"""Layers: functions of a builder and tensors (references) that add what the layer computes and give its result.

One formula per layer, in the op table's ops, for every reader: a source is a table "their op → nn.f". Functions raise
UnsupportedOpError without ``issues``, which the reader completes with the node or layer it was at.
"""
