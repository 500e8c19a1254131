"""Searches over baffle layouts, their check by the reference solver, and what leaves the building.

`gns-design optimize` (cli.py) runs a search, verifies its best layouts and writes a run folder;
run.py is the same from Python.
"""
