"""SavedModels: ``saved_model.pb`` with the ``serve`` tag and signatures. All weights are constants of the graph."""
