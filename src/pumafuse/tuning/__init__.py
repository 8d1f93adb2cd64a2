"""From recorded runs to the noise, the delays and the plant that explain them best."""
