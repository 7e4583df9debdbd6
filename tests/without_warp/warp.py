"""Stands before Warp on the path of processes that tests start: see tests/conftest.py."""

raise ImportError("hidden from this process")
