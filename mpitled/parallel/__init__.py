"""Parallel computing: ranks, the exchange of nodal values between ranks, and the subdomain of each rank."""
