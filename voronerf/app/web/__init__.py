"""Exports a trained run as a page that draws it in any browser with WebGPU."""

from voronerf.app.web.packing import Packed, pack
from voronerf.app.web.page import export_web, page_of, turntable
from voronerf.app.web.shader import CannotDraw

__all__ = ["CannotDraw", "Packed", "export_web", "pack", "page_of", "turntable"]
