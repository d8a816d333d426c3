"""What `uavrl bench` measures: rates by the clock, each beside a floor measured in the same run."""
