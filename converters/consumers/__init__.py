"""What a policy is written for: the programs that load it, with the rules that they have."""
