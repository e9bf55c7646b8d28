"""The verbs of the program: one module each, with `Arguments` and `run`.

`Arguments` is a frozen dataclass that tyro turns into options; `run(arguments, progress)` does the
work through one stage function and returns the final report as plain values.
"""
