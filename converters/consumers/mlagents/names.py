"""What ML-Agents' C# side calls the inputs and outputs of a model, one row for all of its players and checkers.

0.1 and 0.2 called a vector ``state`` and an image ``observation_i`` (``tensorflowsharp.py``); from 0.3 to API version 2
the names of observations are these, from version 3 on ``obs_i`` (``input_mapping.observation_names``). Names of
constants are in ``signatures/roles.py``, as the trainers wrote them.
"""

from __future__ import annotations

VECTOR, VISUAL = "vector_observation", "visual_observation_"
MASKS, PREVIOUS, EPSILON, SEQUENCE = "action_masks", "prev_action", "epsilon", "sequence_length"
RECURRENT_IN, RECURRENT_OUT = "recurrent_in", "recurrent_out"
ACTION, CONTINUOUS, DISCRETE = "action", "continuous_actions", "discrete_actions"
DETERMINISTIC = "deterministic_"
VALUE, ACTION_PROBS = "value_estimate", "action_probs"
