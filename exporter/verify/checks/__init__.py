"""The checks of a verification: each takes what is tried and one participant, and gives typed findings."""
