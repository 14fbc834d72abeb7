"""The effect of page pools on frames, memory and the first picture.

`measure` flies and teleports over a field of copies; `pool_memory`, `pool_slots` and
`first_picture` measure one aspect each of such a field, `page_policy.cpp` the
decisions.
"""
