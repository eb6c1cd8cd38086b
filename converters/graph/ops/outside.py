"""Ops that have no entry in the table, because none is left when the compiler begins: variables, calls, order.

Readers replace them (a variable by its value, a call by what the function computes) or leave them out. TensorFlow's
names, 1.0 to 2.21.
"""

from __future__ import annotations

#: Ops that keep a value in a checkpoint.
VARIABLES = frozenset(("VariableV2", "Variable", "VarHandleOp", "AutoReloadVariable"))
#: Ops that give a variable a value, and those that take it from a checkpoint.
ASSIGNS = frozenset(("Assign", "AssignVariableOp"))
RESTORES = frozenset(("RestoreV2", "Restore", "RestoreSlice"))
#: How the names of ops begin that only training runs: they change or keep variables.
EFFECTS = ("Assign", "Apply", "ResourceApply", "SparseApply", "Scatter", "ResourceScatter", "Save", "Restore")
#: What a variable of TensorFlow 2 is read by, the variable itself among them.
READS = frozenset(("VarHandleOp", "ReadVariableOp", "ResourceGather", "VariableShape"))
#: Ops that may hang behind a control input, where they are left out: they compute nothing that anyone reads.
ORDERING = frozenset(("NoOp", "Assert"))
#: Ops that call the function which their attribute ``f`` names; loops and branches whose bodies are functions.
CALLS = frozenset(("PartitionedCall", "StatefulPartitionedCall", "TPUPartitionedCall"))
WHILES = frozenset(("While", "StatelessWhile"))
IFS = frozenset(("If", "StatelessIf"))
CASES = frozenset(("Case", "StatelessCase"))
#: Every op that calls functions, and those of them that are written out.
FUNCTIONAL = CALLS | WHILES | IFS | CASES
CALLING = CALLS | WHILES | IFS
