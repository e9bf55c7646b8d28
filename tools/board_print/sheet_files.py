"""Sheets as PDF and SVG: vectors in true millimetres, the same bytes for the same sheet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape

from reportlab.pdfgen.canvas import Canvas

from capture.arrays import Floats
from capture.product import replacing
from tools.board_print.sheet import Sheet

_POINT_MM = 72.0 / 25.4
_EVEN_ODD = 0  # reportlab's FILL_EVEN_ODD


def write_pdf(path: Path, sheets: Sequence[Sheet]) -> None:
    """Write sheets as the pages of one PDF that asks viewers to print it unscaled.

    Args:
        path: the file.
        sheets: at least one.
    """
    with replacing(path) as partial:
        canvas = Canvas(str(partial), invariant=1, pageCompression=1)
        canvas.setTitle(sheets[0].title)
        canvas.setAuthor("likeness")
        canvas.setViewerPreference("PrintScaling", "None")
        for sheet in sheets:
            _pdf_page(canvas, sheet)
            canvas.showPage()
        canvas.save()


def write_svg(path: Path, sheet: Sheet) -> None:
    """Write a sheet as SVG."""
    with replacing(path) as partial:
        partial.write_text(svg_text(sheet), encoding="utf-8", newline="\n")


def svg_text(sheet: Sheet) -> str:
    """The SVG of a sheet; its unit is the millimetre."""
    wide, high = (_number(side) for side in sheet.page_mm)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide}mm" height="{high}mm" '
        f'viewBox="0 0 {wide} {high}">',
        f"<title>{escape(sheet.title)}</title>",
        f'<rect width="{wide}" height="{high}" fill="#fff"/>',
        f'<path id="pattern" fill="#000" fill-rule="evenodd" d="{_svg_path(sheet.loops)}"/>',
    ]
    for stroke in sheet.strokes:
        ends = " ".join(
            f'{key}="{_number(value)}"'
            for key, value in zip(
                ("x1", "y1", "x2", "y2"), (stroke.x0, stroke.y0, stroke.x1, stroke.y1), strict=True
            )
        )
        lines.append(f'<line {ends} stroke="#000" stroke-width="{_number(stroke.width)}"/>')
    for words in sheet.words:
        x, y, size = _number(words.x), _number(words.y), _number(words.size)
        lines.append(
            f'<text x="{x}" y="{y}" font-size="{size}" '
            f'font-family="Helvetica, Arial, sans-serif">{escape(words.text)}</text>'
        )
    return "\n".join([*lines, "</svg>", ""])


def _svg_path(loops: Sequence[Floats]) -> str:
    parts = []
    for loop in loops:
        points = " L".join(f"{_number(x)} {_number(y)}" for x, y in loop.tolist())
        parts.append(f"M{points}Z")
    return "".join(parts)


def _number(value: float) -> str:
    """A length to the nanometre, without needless zeros."""
    return f"{value:.6f}".rstrip("0").rstrip(".")


def _pdf_page(canvas: Canvas, sheet: Sheet) -> None:
    wide, high = sheet.page_mm
    canvas.setPageSize((wide * _POINT_MM, high * _POINT_MM))

    def place(x: float, y: float) -> tuple[float, float]:
        return x * _POINT_MM, (high - y) * _POINT_MM

    canvas.setFillGray(0)
    canvas.setStrokeGray(0)
    path = canvas.beginPath()
    for loop in sheet.loops:
        first, *others = loop.tolist()
        path.moveTo(*place(*first))
        for point in others:
            path.lineTo(*place(*point))
        path.close()
    canvas.drawPath(path, stroke=0, fill=1, fillMode=_EVEN_ODD)
    for stroke in sheet.strokes:
        canvas.setLineWidth(stroke.width * _POINT_MM)
        canvas.line(*place(stroke.x0, stroke.y0), *place(stroke.x1, stroke.y1))
    for words in sheet.words:
        canvas.setFont("Helvetica", words.size * _POINT_MM)
        canvas.drawString(*place(words.x, words.y), words.text)
