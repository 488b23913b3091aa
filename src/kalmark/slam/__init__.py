"""The system: events in, reports out."""
