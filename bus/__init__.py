"""Emulated CAN FD buses and the Zenoh link: wires, impairments, messages, gateway, python-can interface."""
