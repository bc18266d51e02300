"""The twin behind the wires of the real devices: emulators that speak their protocols byte for byte, on loopback."""
