"""Largest difference of every column of two outputs of an exported law's example: compare_outputs.py MAIN.C ONE TWO

MAIN.C is the example's source, which names the columns.
"""

import re
import sys
from pathlib import Path

import numpy as np

source, *outputs = sys.argv[1:]
columns = re.search(r"to the last digit:\n((?: \* {5}.*\n)+)", Path(source).read_text(encoding="utf-8"))
names = re.findall(r"[\w.]+", columns.group(1))
one, two = (np.loadtxt(path, delimiter=",", ndmin=2) for path in outputs)
for name, apart in zip(names, np.abs(one - two).T, strict=True):
    print(f"{name:20} {apart.max():10.3g}  in {np.count_nonzero(apart):5} of {len(apart)} steps")
