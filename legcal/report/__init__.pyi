from .calibrate_table import summary as summary
from .identify_tables import identify_table as identify_table
from .progress_bars import progress_on_stderr as progress_on_stderr
from .tables import accuracy_table as accuracy_table
from .tables import camera_table as camera_table
from .tables import inspect_table as inspect_table
from .tables import location_table as location_table
from .tables import noise_table as noise_table
