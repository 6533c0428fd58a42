"""Drop what the filter left out of a session, or cr-rate counts it as noticed: python drop_skipped.py SESSION."""

import sqlite3
import sys

SKIPPED = "job_id IN (SELECT job_id FROM work_results WHERE worker_outcome = 'SKIPPED')"

with sqlite3.connect(sys.argv[1]) as session:
    for table in ("mutation_specs", "work_items", "work_results"):
        session.execute(f"DELETE FROM {table} WHERE {SKIPPED}")
