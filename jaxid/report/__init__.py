"""The page that tells a discovery to a colleague: one HTML file that needs nothing else."""

from ._page import write_report as write_report
