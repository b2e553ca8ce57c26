# SPDX-License-Identifier: MIT
"""The page `sim-client web`: bodies in a browser that can be dragged, changed and watched.

It needs the extra web (viser), which only `clients.web.page` imports.
"""
