"""Logs on disk: MCAP written crash-safe, MCAP and CSV read into a `Record`, damage named and never
passed on as data.

The MCAP holds one topic a rate group, messages in little-endian CDR of float64 fields described by
a ros2msg schema. Every chunk repeats its schemas and channels and carries a CRC, so each one can be
read without the others."""

from ehbench.data.logs.checks import check_record
from ehbench.data.logs.writing import CHUNK_SIZE, LogWriter, write_log
