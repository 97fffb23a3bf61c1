"""`bigs bench`: each measurement, and the harder clips that some of them use."""
