"""Unity as a consumer: what Unity's importers, ML-Agents' checkers and its players do with a file, without Unity.

``checker.check_file`` is the way in. A file goes one way: ``consumers`` (which release, on which runtime) →
``importing`` (what its importer refuses) → ``barracuda_model`` or ``sentis_model`` (what it then holds) → ``rules``
(what the Inspector lists, in Unity's order and words) and the exception that loading for running throws →
``playing`` (what ML-Agents' player does with it: the tables ``players``, ``forms`` and ``layers``, asked of a
``scene``), and what of the graph the importer takes for something else, by the tables ``constructs`` and ``readings``.

Everything here was measured outside of the Unity Editor, on the CPU; nothing of Unity is in it.
"""
