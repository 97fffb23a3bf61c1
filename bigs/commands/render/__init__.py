"""Pictures of a finished run: single ones, series, the report's, and the live viewer's."""
