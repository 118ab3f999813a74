"""Reading and writing of files, each in one way, with errors that say what is wrong and what to do.

Read ``reading`` (regular files only), ``writing`` (whole or not at all), then ``documents``: JSON as typed records.
"""
