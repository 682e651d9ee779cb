"""The paper's Figs. 4 to 8 made anew: simulate, measure, draw, and say what differs."""

from tapetum.report.paper.write import FIGURES, SIZES, Reproduction, reproduce

__all__ = ["FIGURES", "SIZES", "Reproduction", "reproduce"]
