# SPDX-License-Identifier: MIT
"""The command `sim-server certs`: an authority of one's own, and certificates for servers, workers and clients."""
