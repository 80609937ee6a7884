"""The HTTP service over terrasim's public names. Empty until the service is built."""
