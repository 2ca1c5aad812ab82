"""The matrix of extremes as jobs/studies keeps it: `mpitled stability`, and its table and picture beside the others.

python jobs/stability.py [FOLDER]   (out/stability)

Some 13 minutes on one core; what has been run is not run again.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from mpitled.batch import stability

out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/stability")
print(stability.summary(stability.matrix(out)))
for name in ("stability.csv", "stability.png"):
    shutil.copy(out / name, Path(__file__).parent / "studies" / name)
