"""Tell the world: figures, the HTML report, tables as CSV and JSON, robot files."""
