"""Reports of discoveries: each is one self-contained HTML file."""

from ._page import write_report as write_report
