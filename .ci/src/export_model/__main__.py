"""``python -m export_model`` is ``export-model``."""

from export_model.exporter.cli.main import main

if __name__ == "__main__":
    main()
