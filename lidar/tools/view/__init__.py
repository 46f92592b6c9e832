"""A recorded drive as one web page, served frame by frame, or in a window."""

from lidar.tools.view.page import view_drive as view_drive
