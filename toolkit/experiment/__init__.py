"""The one pipeline of every comparison: load, audit, start, run, score; one seed or many, here or on a cluster.

Reading order: recording (the data) -> units (one run of one estimator) -> workers, cluster (where units run) ->
outcome_store (results on disk, under a key of all that they depend on) -> references (estimates of other systems) ->
pipeline -> comparison (the result, with verdicts on stated uncertainty) -> contests (who wins, who contradicts the
measured motion); grid (many settings and planted faults at once) -> sweep (along axes), explanation (in what estimators
differ, and what each of these brings); statistics. configuration: a comparison as a file.
"""
