"""The figures of the paper, drawn for a run: costs, speeds, tracks, segments, models and topology."""
