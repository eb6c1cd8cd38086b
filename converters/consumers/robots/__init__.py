"""Robots and games outside Unity: the names that Isaac Lab and Godot RL Agents load, and the rules of their loaders."""
