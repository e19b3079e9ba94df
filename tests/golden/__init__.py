"""The golden corpus: small inputs, each command and public call on them, and what came of it, frozen."""
