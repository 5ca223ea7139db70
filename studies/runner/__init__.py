"""The runner of studies: measures their cases, writes their results, and shows these in the docs.

`study` defines a study, `options` its command line, `cases` measures it case by case, `result` and `reductions` build
its tables, `provenance`, `sources` and `machine` describe the origin of a result, `pages` shows results in docs/.
"""
