"""Wrong input of every kind: from users, files, the network and the radio."""
