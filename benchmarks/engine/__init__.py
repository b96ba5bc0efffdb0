"""What every measuring command shares: tasks, records, tables, processes. Knows nothing of CT."""
