"""Timings from and to the files of others: one file a format, each with `read_` and perhaps `write_`."""
