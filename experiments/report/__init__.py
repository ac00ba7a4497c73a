"""Tables and figures from the logs of runs."""
