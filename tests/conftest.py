from hypothesis import settings

# A shared machine can stall for longer than any deadline that would still mean something.
settings.register_profile("v3dg", deadline=None, print_blob=True)
settings.load_profile("v3dg")
