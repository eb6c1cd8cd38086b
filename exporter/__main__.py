"""``python -m exporter`` is ``export-model``."""

from exporter.cli.main import main

if __name__ == "__main__":
    main()
