"""Numbers from files of other tools: CSV and Parquet tables, MAT-files."""
