"""The stability lab: experiments on scenarios."""
