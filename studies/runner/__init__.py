"""The runner of studies: what a study is, how its cases are measured, and where its results go.

`study` says what a study is, `options` makes its command, `cases` measures it case by case, `result` and `reductions`
are its tables, `provenance`, `sources` and `machine` say where a result comes from, `pages` shows results in docs/.
"""
