"""What tests of whole runs may ask for."""

import pytest


@pytest.fixture
def no_report(monkeypatch):
    """Leave out the pictures, which take most of the time of so short a run."""
    monkeypatch.setattr("design.report.write_report", lambda folder: None)
