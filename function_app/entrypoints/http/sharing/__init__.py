"""Routes of shares, invitations and transfers."""
