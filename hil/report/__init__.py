"""What a person looks at: the page, its plots, the video, and progress on a terminal."""
