"""One thread of linear algebra a process: imported before NumPy, which reads it once.

The matrices are small and the test processes many; threads would only wait for each other.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
