"""What `import t6gps` offers (docs/python.md): runs from Python, without printing and without touching the caller.

Errors are those of `t6gps.storage.errors`. Messages go to the loggers below `t6gps`; a program that wants to see them
sets up `logging`.
"""

import logging

logging.getLogger("t6gps").addHandler(logging.NullHandler())  # else Python prints warnings
