"""The families of camera files: named fields, numbers alone; each module reads one."""
