"""The effect of page pools on frames, memory and the time to the first picture.

`measure` draws flights and teleports over a field of copies. `pool_memory`,
`pool_slots` and `first_picture` each measure one aspect of such a field.
`page_policy.cpp` measures the decisions about pages.
"""
