"""What people look at: reports, explanations, status, pictures and recordings."""
