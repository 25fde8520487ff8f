"""Light assignment: one file an algorithm, all with one signature.

`assign(lights: Sphere, clusters: Clusters, capacity, chunk, ...) -> (LightLists, AssignCounts)`.
"""
