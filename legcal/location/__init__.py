"""Where the base stands in the world and the tool in the platform, from measured tool poses."""
