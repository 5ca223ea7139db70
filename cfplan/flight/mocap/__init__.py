"""Poses from a motion capture system: `source.pose_source` for a flight, `feed.Feed` for whoever wants every body."""
