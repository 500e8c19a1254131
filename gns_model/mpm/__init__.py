"""The material point method: the solver that makes the training data and checks the answers."""

from gns_model.mpm.solver import MpmSimulator

__all__ = ["MpmSimulator"]
