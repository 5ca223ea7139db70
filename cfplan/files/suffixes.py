"""The endings of file names that tell what a file holds; apart, so that commands need not load what reads it."""

PLAN_SUFFIX = ".parquet"
