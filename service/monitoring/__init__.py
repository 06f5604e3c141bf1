"""What the runs of a root measure, for Prometheus (docs/observability.md)."""
