"""What rays can meet: the static scene and the road users in it."""
