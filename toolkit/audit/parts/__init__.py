"""What several faults share; no file here is a fault."""
