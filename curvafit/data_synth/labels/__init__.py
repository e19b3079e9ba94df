"""What is exactly known of a generated shape: masks, distances, skeletons, centrelines."""
