"""What the processes of the tests and those that they start have in common: imported before NumPy.

One thread of linear algebra each: the matrices are small and the processes many; threads would only
wait for each other. And compiled modules are kept, also where ``PYTHONDONTWRITEBYTECODE`` is set:
compiling is a third of the time of a short command, and more than half of that until a first test.
Tests read YAML with libyaml, in a tenth of the time.
"""

import os
import sys
from functools import partial

import yaml

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
if yaml.__with_libyaml__:
    vars(yaml)["safe_load"] = partial(yaml.load, Loader=yaml.CSafeLoader)
