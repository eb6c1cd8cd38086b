"""Passes: functions from graph to graph, each with a stated pre- and postcondition. ``compile`` calls them in order."""
