"""The paper's Figs. 4 to 6 made anew: simulate, measure, draw, and say what differs."""

from tapetum.report.paper.write import FIGURES, Reproduction, reproduce

__all__ = ["FIGURES", "Reproduction", "reproduce"]
