"""Seeds, tasks and trials over the devices of a host, and over hosts."""
