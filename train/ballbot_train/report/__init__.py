"""What people look at: figures, replays and the report page."""
