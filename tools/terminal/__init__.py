"""The operator's console in a terminal. It stands on `capture.rom`, as the browser console will.

Textual is imported by `tools.terminal.console` and what it needs, never here: other verbs start
without it.
"""
