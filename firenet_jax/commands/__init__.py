"""One module a command of `firenet`, named as the command: its settings, and `run(settings)`.

The settings are a frozen dataclass, of which the command line is made (`cli`). No other room
imports this one.
"""
