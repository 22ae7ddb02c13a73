"""Campaigns: many drawn missions full of faults, every referee on, until something breaks or all hold."""
