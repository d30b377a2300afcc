"""Images, charts, HTML pages and 3D recordings of frames and labels."""
