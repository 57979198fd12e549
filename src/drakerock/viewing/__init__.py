"""What a person looks at: replay, figures, report."""
