"""What pools of pages do to frames, memory and the first picture.

`measure` flies and teleports over a field of copies; `pool_memory`, `pool_slots` and
`first_picture` ask one thing each of such a field, `page_policy.cpp` of decisions.
"""
