"""Long work: processes and clusters, resumable jobs, shards, and what the terminal shows."""
