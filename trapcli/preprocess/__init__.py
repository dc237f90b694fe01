"""From raw counts to attenuation: background, −log, region of interest."""
