"""The paper's tables and figures, one suite each: a simulator beside our own solver and the paper.

A suite is a function `run(simulator, Setup) -> SuiteResult`; `registry` names them, says which fit
a model and writes what they return, and `command` is `gns-model evaluate`.
"""
