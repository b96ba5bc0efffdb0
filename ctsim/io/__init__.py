"""Files of other programs: CT volumes (`volumes`), measured scans (`scans`), and shards for training."""
