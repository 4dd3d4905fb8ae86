"""Images: OpenEXR files, estimates of pixels, and the comparison of renders.

Nothing here knows Mitsuba, so that renders of any origin can be compared.
"""
