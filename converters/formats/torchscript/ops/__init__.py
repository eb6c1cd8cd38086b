"""Ops of TorchScript programs, by what they do: functions of the machine and of an op's operands in ATen's order."""
