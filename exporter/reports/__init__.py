"""What verification found, for people and for CI: JUnit XML, Markdown, one self-contained HTML page, JSON Schemas."""
