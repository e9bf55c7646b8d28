"""XML of strangers: an element tree without document types, entities or bottomless nesting."""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from capture.errors import CameraError

_DEEPEST = 64


def parse_xml(data: bytes, where: str) -> Element:
    """The root element of an XML document.

    A document type is refused before it is read, so that no entity is ever declared or expanded
    and nothing outside the document is fetched.

    Args:
        data: the document.
        where: the file, for messages.

    Raises:
        CameraError: naming the file, when it is not XML, declares a document type, or is nested
            more than 64 deep.
    """
    builder = TreeBuilder()
    parser = expat.ParserCreate()
    depth = 0

    def refuse(*_: Any) -> None:
        raise CameraError(
            f"{where}: holds a document type (<!DOCTYPE ...>), which no file of cameras has and "
            "which may hide an attack; remove it"
        )

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _DEEPEST:
            raise CameraError(f"{where}: nested more than {_DEEPEST} elements deep")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, LookupError, ValueError) as error:
        raise CameraError(f"{where}: not readable as XML: {error}") from error
    return builder.close()
