"""Everything that a user, a file, a network or a radio gives, and the ways in which it can be wrong."""
