"""Files that come in and go out, each in one way, with an error that says what stands in the way and what to do.

Read ``reading`` (regular files only), ``writing`` (whole or not at all), then ``documents``: JSON as typed records.
"""
